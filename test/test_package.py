"""What colcon builds, and how make drives it; in copies, so that nothing is built in the tree."""

from __future__ import annotations

import ast
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = ('ablate', 'calibrate', 'convert', 'demo', 'download_weights', 'evaluate', 'play')
EXECUTABLES = ('frontend', 'loop_closure', 'slam', *COMMANDS)
SOURCES = ('aim_slam_ros', 'msg_adapters', 'config', 'launch', 'resource', 'Makefile', 'setup.py',
           'setup.cfg', 'package.xml', 'requirements.txt', 'requirements-dev.txt',
           'requirements-ros.txt')
TIMEOUT_S = 120.0
needs_colcon = pytest.mark.skipif(importlib.util.find_spec('colcon_core') is None,
                                  reason='needs colcon: make venv installs it')


@pytest.fixture(scope='module')
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources, built by make with the python of this test."""
    tree = tmp_path_factory.mktemp('a checkout')
    ignored = shutil.ignore_patterns('__pycache__')
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tree / name, ignore=ignored)
        else:
            shutil.copy2(ROOT / name, tree / name)
    (tree / '.venv').symlink_to(sys.prefix)
    (tree / 'ready').touch()
    _make(tree, 'build')
    return tree


def _make(tree: Path, *words: str, expected: int = 0, **environment: str) -> str:
    """What a target prints. The virtual environment is taken as it is: nothing is installed."""
    done = subprocess.run(
        ['make', '-C', str(tree), '--no-print-directory', 'READY=ready', '-o', 'ready', *words],
        capture_output=True, text=True, timeout=TIMEOUT_S, env={**_clean(), **environment})
    assert (done.returncode != 0) == bool(expected), done.stdout + done.stderr
    return done.stdout + done.stderr


def _clean() -> dict[str, str]:
    """The environment without what an outer make hands on."""
    return {name: value for name, value in os.environ.items()
            if name not in ('MAKEFLAGS', 'MAKELEVEL', 'MFLAGS', 'MAKEOVERRIDES', 'PYTHONPATH',
                            '_ROS_WHEELS_BOOTSTRAP_COMPLETE')}


def _in_workspace(tree: Path, command: str) -> subprocess.CompletedProcess[str]:
    """Run where the built package is sourced, as `ros2 run` does."""
    script = (f'export PATH="$TREE/.venv/bin:$PATH" COLCON_PYTHON_EXECUTABLE=.venv/bin/python; '
              f'. install/local_setup.sh; cd /; {command}')
    return subprocess.run(['sh', '-c', script], capture_output=True, text=True, timeout=TIMEOUT_S,
                          cwd=tree, env={**_clean(), 'TREE': str(tree)})


@needs_colcon
def test_executables_are_where_ros2_run_looks(tree: Path) -> None:
    folder = tree / 'install' / 'aim_slam_ros' / 'lib' / 'aim_slam_ros'
    assert {path.name for path in folder.iterdir()} == set(EXECUTABLES)
    for name in EXECUTABLES:
        # the python of the virtual environment that is active, not of the one that built
        assert (folder / name).read_text().startswith('#!/usr/bin/env python3\n')
        assert os.access(folder / name, os.X_OK)


@needs_colcon
@pytest.mark.parametrize('name', COMMANDS)
def test_a_built_command_answers(tree: Path, name: str) -> None:
    done = _in_workspace(tree, f'"$TREE"/install/aim_slam_ros/lib/aim_slam_ros/{name} --help')
    assert done.returncode == 0, done.stderr
    assert f'usage: {name}' in done.stdout


@needs_colcon
def test_every_entry_point_is_in_the_built_package(tree: Path) -> None:
    pytest.importorskip('rclpy', reason='needs ROS 2: make venv installs its wheels')
    done = _in_workspace(tree, '''python3 -c "
import importlib.metadata, sys
for point in importlib.metadata.distribution('aim-slam-ros').entry_points:
    point.load()
    print(point.name, sys.modules[point.module].__file__)
"''')
    assert done.returncode == 0, done.stderr
    files = dict(line.split(' ', 1) for line in done.stdout.splitlines())
    assert set(files) == set(EXECUTABLES)
    assert all(file.startswith(str(tree / 'install')) for file in files.values())


@needs_colcon
def test_a_build_with_links_takes_the_active_python_too(tree: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, '-m', 'colcon', '--log-base', str(tmp_path / 'log'), 'build',
         '--symlink-install', '--build-base', str(tmp_path / 'build'), '--install-base',
         str(tmp_path / 'install')], cwd=tree, capture_output=True, text=True, timeout=TIMEOUT_S,
        env={**_clean(), 'COLCON_DEFAULTS_FILE': os.devnull})
    assert done.returncode == 0, done.stderr
    folder = tmp_path / 'install' / 'aim_slam_ros' / 'lib' / 'aim_slam_ros'
    assert {path.name for path in folder.iterdir()} == set(EXECUTABLES)
    assert all(path.read_text().startswith('#!/usr/bin/env python3\n#')
               for path in folder.iterdir())


@needs_colcon
def test_what_launch_files_and_users_look_for_is_installed(tree: Path) -> None:
    share = tree / 'install' / 'aim_slam_ros' / 'share'
    for folder in ('config', 'launch'):
        present = {path.name for path in (share / 'aim_slam_ros' / folder).iterdir()}
        assert present == {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
    assert (share / 'aim_slam_ros' / 'package.xml').is_file()
    assert (share / 'ament_index' / 'resource_index' / 'packages' / 'aim_slam_ros').is_file()


@needs_colcon
def test_building_again_does_nothing_until_a_source_changes(tree: Path) -> None:
    built = tree / 'install' / '.built'
    before = built.stat().st_mtime_ns
    start_s = time.monotonic()
    assert _make(tree, 'build').strip() in ('', "make: Nothing to be done for 'build'.")
    assert time.monotonic() - start_s < 2.0     # it only looks at the files' times
    assert built.stat().st_mtime_ns == before

    module = tree / 'aim_slam_ros' / 'passing.py'
    copy = next((tree / 'install').rglob('site-packages')) / 'aim_slam_ros' / 'passing.py'
    module.write_text('')
    _make(tree, 'build')
    assert copy.exists()
    module.unlink()
    _make(tree, 'build')
    assert not copy.exists()        # a stale module would still be importable


@needs_colcon
def test_make_demo_hands_over_its_arguments_in_a_clean_environment(tree: Path,
                                                                   tmp_path: Path) -> None:
    """As in a shell where a ROS 2 is sourced whose modules would break ours."""
    (tmp_path / 'yaml.py').write_text('raise ImportError("the modules of another ROS")')
    said = _make(tree, 'demo', "DATASET=/there is/no one's folder", f'OUT={tmp_path}/a folder',
                 'MODEL=classical', 'RATE=2', expected=2, PYTHONPATH=str(tmp_path),
                 AMENT_PREFIX_PATH='/opt/ros/jazzy', RMW_IMPLEMENTATION='rmw_cyclonedds_cpp')
    assert "/there is/no one's folder" in said
    assert 'another ROS' not in said and 'usage' not in said and 'Traceback' not in said


def test_make_help_names_every_target() -> None:
    text = (ROOT / 'Makefile').read_text(encoding='utf-8')
    phony = re.search(r'^\.PHONY: (.*)$', text, re.MULTILINE)
    assert phony
    said = _make(ROOT, 'help')
    for target in set(phony.group(1).split()) - {'help'}:
        assert f'make {target}' in said


def test_versions_agree() -> None:
    version = re.search(r"version='([\d.]+)'", (ROOT / 'setup.py').read_text(encoding='utf-8'))
    assert version and _package().findtext('version') == version.group(1)


def test_package_xml_names_the_ros_packages_that_are_imported() -> None:
    python_of = {'tf2_ros': 'tf2_ros_py'}
    ros = re.compile(r'\w+_(msgs|srvs|interfaces)|rclpy|tf2_\w+|launch|launch_ros|'
                     'ament_index_python')
    found = {name for folder in ('aim_slam_ros', 'msg_adapters', 'launch')
             for path in (ROOT / folder).rglob('*.py') for name in _imported(path)
             if ros.fullmatch(name)}
    assert 'rclpy' in found
    named = {element.text for element in _package().iter('exec_depend')}
    assert {python_of.get(name, name) for name in found} <= named


def _package() -> ElementTree.Element:
    return ElementTree.parse(ROOT / 'package.xml').getroot()


def _imported(path: Path) -> set[str]:
    """Top-level packages that a file imports absolutely."""
    out: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            out |= {alias.name.split('.')[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            out.add(node.module.split('.')[0])
    return out
