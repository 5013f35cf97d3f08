# Everything runs in .venv, made from the pinned requirements; no ROS is needed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DATA ?= data
OUT ?= out/benchmark

# Idle OpenMP threads that spin cost other processes several times their own work.
export OMP_WAIT_POLICY := PASSIVE
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := help
.PHONY: help venv test lint benchmark clean

help:
	@echo 'make test    run the tests'
	@echo 'make lint    flake8 and mypy'
	@echo 'make benchmark DATA=folder OUT=folder'
	@echo '             measure both pipelines on the recordings in DATA; takes some minutes'
	@echo 'make venv    make $(VENV) from the pinned requirements (test and lint do so themselves)'
	@echo 'make clean   remove $(VENV) and caches'

venv: $(READY)

test: $(READY)
	@$(BIN)/python -m pytest

lint: $(READY)
	@status=0; $(BIN)/python -m flake8 || status=1; $(BIN)/python -m mypy || status=1; exit $$status

benchmark: $(READY)
	@$(BIN)/python benchmark/offline.py --data $(DATA) --out $(OUT)

clean:
	@rm -rf $(VENV) .pytest_cache .mypy_cache
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The .pth file makes the sources importable from anywhere. `pip install -e` would not do: setup.cfg
# sends scripts to lib/aim_slam_ros, where `ros2 run` looks for them.
$(READY): requirements.txt requirements-dev.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	{ echo 'Python 3.11 or newer is needed, $(PYTHON) is another: try make PYTHON=python3.12' >&2; \
	exit 1; }
	@echo 'Making $(VENV) (once; some minutes, mostly for torch)'
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -qq --requirement requirements-dev.txt
	@echo '$(CURDIR)' > "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/aim_slam_ros.pth"
	@touch $@
