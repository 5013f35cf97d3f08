# Everything runs in .venv, made from the pinned requirements; no ROS is needed, and where a ROS 2 is
# sourced it is left alone. `make PYTHON=python3.12 ...` takes another interpreter for .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
BUILT := install/.built
DATA ?= data
# What the package is built from; folders too, so that a removed file counts.
SOURCES := $(shell find aim_slam_ros msg_adapters config launch resource -name __pycache__ -prune \
	-o -print) package.xml setup.cfg setup.py

export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Nothing started here talks to other machines, and the wheels know one middleware.
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
# A sourced ROS 2, or the python of another virtual environment that called make, would mix its
# modules and libraries with those of .venv.
ifneq ($(AMENT_PREFIX_PATH)$(COLCON_PREFIX_PATH)$(_ROS_WHEELS_BOOTSTRAP_COMPLETE),)
unexport AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH PYTHONPATH LD_LIBRARY_PATH \
	ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION _ROS_WHEELS_BOOTSTRAP_COMPLETE
endif

# Source what colcon built. Told the prefix it need not be where it was built, and told python by a
# relative path it allows for a space in the checkout's.
SETUP = export COLCON_CURRENT_PREFIX="$(CURDIR)/install" COLCON_PYTHON_EXECUTABLE=$(BIN)/python && \
	. install/local_setup.sh && unset COLCON_CURRENT_PREFIX COLCON_PYTHON_EXECUTABLE

# $(call given,--option,VARIABLE): nothing where the variable is empty; else quoted for the shell.
quoted = '$(subst ','\'',$(1))'
given = $(if $($(2)),$(1) $(call quoted,$($(2))))

.DEFAULT_GOAL := help
.PHONY: help venv build demo test lint benchmark parameters clean

help:
	@echo 'make demo [DATASET=folder, bag or video] [OUT=folder] [MODEL=name] [RATE=factor]'
	@echo '             play a recording (default: a rendered room) to both nodes, each in its own'
	@echo '             process, and write picture, trajectory and map to OUT (default: out/demo)'
	@echo 'make build   colcon build into build/, install/ and log/ (demo does so itself)'
	@echo 'make test    run the tests'
	@echo 'make lint    flake8 and mypy'
	@echo 'make benchmark DATA=folder OUT=folder'
	@echo '             measure both pipelines on the recordings in DATA; takes some minutes'
	@echo 'make parameters'
	@echo '             write config/*.yaml anew from the settings in the code'
	@echo 'make venv    make $(VENV) from the pinned requirements (the others do so themselves)'
	@echo 'make clean   remove $(VENV), what was built, and caches'
	@echo 'make PYTHON=python3.12 ... takes another interpreter than python3 for $(VENV)'

venv: $(READY)

build: $(BUILT)

demo: OUT ?= out/demo
demo: $(BUILT)
	@export PATH="$(CURDIR)/$(BIN):$$PATH" && $(SETUP) && \
	exec install/aim_slam_ros/lib/aim_slam_ros/demo $(call given,,DATASET) \
	$(call given,--out,OUT) $(call given,--model,MODEL) $(call given,--rate,RATE)

test: $(READY)
	@$(BIN)/python -m pytest

lint: $(READY)
	@status=0; $(BIN)/python -m flake8 || status=1; $(BIN)/python -m mypy || status=1; exit $$status

benchmark: OUT ?= out/benchmark
benchmark: $(READY)
	@for part in offline ros truth; do $(BIN)/python benchmark/$$part.py \
	--data $(call quoted,$(DATA)) --out $(call quoted,$(OUT)) || exit 1; done
	@for part in frontend memory vggt; do $(BIN)/python benchmark/$$part.py \
	--out $(call quoted,$(OUT)) || exit 1; done

parameters: $(READY)
	@$(BIN)/python -m aim_slam_ros.cli.parameters config

clean:
	@rm -rf $(VENV) build install log .pytest_cache .mypy_cache
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The .pth file makes the sources importable from anywhere. `pip install -e` would not do: setup.cfg
# sends scripts to lib/aim_slam_ros, where `ros2 run` looks for them.
$(READY): requirements.txt requirements-ros.txt requirements-dev.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	{ echo 'Python 3.11 or newer is needed, $(PYTHON) is another: try make PYTHON=python3.12' >&2; \
	exit 1; }
	@echo 'Making $(VENV) (once; some minutes, mostly for torch)'
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -qq --requirement requirements-dev.txt
	@echo '$(CURDIR)' > "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/aim_slam_ros.pth"
	@touch $@

# From nothing each time, since an installed module would outlive its source; it takes a second.
# The stamp has the time of the start: a source that changes meanwhile is built the next time. A
# personal ~/.colcon/defaults.yaml could ask for another layout; bytecode makes the start faster.
$(BUILT): $(READY) $(SOURCES)
	@rm -rf build/aim_slam_ros install/aim_slam_ros
	@mkdir -p build install && touch build/.started
	@env -u PYTHONDONTWRITEBYTECODE COLCON_DEFAULTS_FILE=/dev/null $(BIN)/python -m colcon build \
	--paths . --event-handlers console_start_end- status- summary- desktop_notification- \
	terminal_title-
	@mv build/.started $@
