"""The launch files start what they say, with names that the nodes know.

``launch`` and ``launch_ros`` cannot be had from the package index, so this file has stand-ins for
the few of their classes that the launch files use: they take the same arguments and only note
them. Everything else (ament_index_python, entry points, settings) is real.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import shutil
import subprocess
import sys
import types
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Callable

import pytest
from test_package import EXECUTABLES

from aim_slam_ros.cli.parameters import NODES
from aim_slam_ros.config import Config

pytest.importorskip('ament_index_python', reason='needs ROS 2: make venv installs its wheels')

ROOT = Path(__file__).resolve().parents[1]
# A value unlike the default for every argument; the others are switches and are toggled.
OTHER = {'image': '/camera/image_raw', 'camera_info': '/camera/info', 'model': 'vggt',
         'image_transport': 'compressed', 'weights': '/data/weights', 'namespace': 'robot',
         'map_frame': 'world', 'odom_frame': 'start', 'base_frame': 'base_link',
         'camera_frame': 'eye', 'params_file': '/data/mine.yaml', 'log_level': 'debug',
         'rate': '2.0', 'start_offset': '3.0', 'clock': '50.0', 'bag': '/data/another bag'}


@dataclass
class _Argument:
    name: str
    default_value: str | None = None
    description: str = ''
    choices: list[str] | None = None


@dataclass
class _Node:
    package: str
    executable: str
    namespace: str = ''
    name: str | None = None
    output: str = 'log'
    arguments: list[str] = field(default_factory=list)
    parameters: list[Any] = field(default_factory=list)
    remappings: list[tuple[str, str]] = field(default_factory=list)
    ros_arguments: list[str] = field(default_factory=list)

    @property
    def overrides(self) -> dict[str, Any]:
        """Parameters that come after those of all files."""
        last = self.parameters[-1] if self.parameters else {}
        return {name: getattr(value, 'value', value) for name, value in last.items()}

    @property
    def files(self) -> list[str]:
        return [str(part) for part in self.parameters[:-1]]


@dataclass
class _Function:
    function: Callable[..., list[Any]]


@dataclass
class _Environment:
    name: str
    value: str


@dataclass
class _Value:
    value: str
    value_type: type


@dataclass
class _Include:
    path: str


@dataclass
class _Context:
    launch_configurations: dict[str, str]


@pytest.fixture
def share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The share folder of an installed package, and the stand-ins in place."""
    index = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'aim_slam_ros').touch()
    out = tmp_path / 'share' / 'aim_slam_ros'
    shutil.copytree(ROOT / 'config', out / 'config')
    shutil.copytree(ROOT / 'launch', out / 'launch')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    for name, contents in _stand_ins(out).items():
        module = types.ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    return out


def _stand_ins(share: Path) -> dict[str, dict[str, Any]]:
    return {
        'launch': {'LaunchDescription': list, 'LaunchContext': _Context},
        'launch.actions': {'DeclareLaunchArgument': _Argument, 'OpaqueFunction': _Function,
                           'SetEnvironmentVariable': _Environment,
                           'IncludeLaunchDescription': _Include},
        'launch.launch_description_sources': {'PythonLaunchDescriptionSource': str},
        'launch.substitutions': {'PathJoinSubstitution': lambda parts: '/'.join(parts)},
        'launch_ros': {},
        'launch_ros.actions': {'Node': _Node},
        'launch_ros.parameter_descriptions': {'ParameterValue': _Value},
        'launch_ros.substitutions': {'FindPackageShare': lambda package: str(share)}}


def _description(path: Path) -> list[Any]:
    spec = importlib.util.spec_from_file_location('launch_file', path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description()


def _started(path: Path, given: dict[str, str]) -> list[Any]:
    """Nodes and environment that a launch file asks for; ``given`` gets the defaults."""
    out: list[Any] = []
    for entity in _description(path):
        if isinstance(entity, _Argument):
            assert entity.description
            if entity.name not in given:
                assert entity.default_value is not None, f'{entity.name} has to be given'
                given[entity.name] = entity.default_value
            assert given[entity.name] in (entity.choices or [given[entity.name]])
        elif isinstance(entity, _Function):
            out += entity.function(_Context(given))
        elif isinstance(entity, _Include):
            out += _started(Path(entity.path), given)
        else:
            out.append(entity)
    return out


def _launch(share: Path, file: str = 'aim_slam', **given: str) -> list[Any]:
    if file == 'replay':
        given.setdefault('bag', '/data/bag')
    return _started(share / 'launch' / f'{file}.launch.py', given)


def test_both_nodes_are_started_with_their_files(share: Path) -> None:
    nodes = _launch(share)
    assert [(node.executable, node.name) for node in nodes] == [
        ('frontend', 'frontend'), ('loop_closure', 'loop_closure')]
    for node in nodes:
        assert node.files == [str(share / 'config' / f'{node.name}.yaml')]
        assert Path(node.files[0]).is_file()
        # nothing else: what the files say is not overruled by an argument nobody gave
        assert node.overrides == {'use_sim_time': False}


@pytest.mark.parametrize('file', ['aim_slam', 'replay'])
def test_every_argument_has_an_effect(share: Path, file: str) -> None:
    declared: dict[str, str] = {'bag': '/data/bag'} if file == 'replay' else {}
    before = _started(share / 'launch' / f'{file}.launch.py', declared)
    for name, default in declared.items():
        other = {'true': 'false', 'false': 'true'}.get(default) or OTHER[name]
        assert other != default
        assert _launch(share, file, **{name: other}) != before, name


def test_parameters_and_executables_exist(share: Path) -> None:
    for switches in ({}, {'single_process': 'true'}, {'rviz': 'true', 'loop_closure': 'false'}):
        started = _launch(share, 'replay', **{**OTHER, **switches})
        for node in (one for one in started if one.package == 'aim_slam_ros'):
            assert node.executable in EXECUTABLES
            known = {*Config().settings(), 'use_sim_time'}
            for name in NODES if node.executable == 'slam' else {node.name} & set(NODES):
                known |= {spec.name for spec in dataclasses.fields(NODES[name])}  # type: ignore
            assert set(node.overrides) <= known
            assert node.namespace == 'robot'


def test_one_process_has_no_name_that_would_rename_both_nodes(share: Path) -> None:
    node, = _launch(share, single_process='true')
    assert node.executable == 'slam' and node.name is None
    assert [Path(file).stem for file in node.files] == ['frontend', 'loop_closure']


def test_without_loop_closure_the_frontend_is_alone(share: Path) -> None:
    for single_process in ('true', 'false'):
        node, = _launch(share, loop_closure='false', single_process=single_process)
        assert node.executable == 'frontend'


@pytest.mark.parametrize('image, info', [
    ('image', 'camera_info'), ('/camera/image_raw', '/camera/camera_info'),
    ('camera/image', 'camera/camera_info'), ('/image', '/camera_info')])
def test_the_calibration_is_beside_the_images(share: Path, image: str, info: str) -> None:
    frontend = _launch(share, image=image)[0]
    assert dict(frontend.remappings) == {
        'image': image, 'image/compressed': f'{image}/compressed', 'camera_info': info}
    frontend = _launch(share, image=image, camera_info='/calibration')[0]
    assert dict(frontend.remappings)['camera_info'] == '/calibration'


def test_rviz_opens_the_view_in_the_namespace(share: Path) -> None:
    rviz = _launch(share, rviz='true', namespace='robot', image='/camera/image_raw')[-1]
    assert (rviz.package, rviz.namespace) == ('rviz2', 'robot')
    assert Path(rviz.arguments[rviz.arguments.index('-d') + 1]).is_file()
    assert ('image', '/camera/image_raw') in rviz.remappings


def test_the_shared_memory_profile_comes_before_the_nodes(share: Path) -> None:
    environment = _launch(share, shared_memory='true')[0]
    assert environment.name == 'FASTRTPS_DEFAULT_PROFILES_FILE'
    assert Path(environment.value).is_file()


def test_a_replay_lives_by_the_time_of_the_bag(share: Path) -> None:
    *nodes, player = _launch(share, 'replay', rviz='true')
    assert len(nodes) == 3 and all(node.overrides['use_sim_time'] for node in nodes)
    assert player.executable == 'play' and '--clock' in player.arguments


def test_the_player_understands_its_arguments(share: Path, tmp_path: Path) -> None:
    """Asked for a bag that is not there it complains of the bag, not of the command line."""
    player = _launch(share, 'replay', bag=str(tmp_path / 'no bag'), loop='true')[-1]
    done = subprocess.run([sys.executable, '-m', 'aim_slam_ros.cli.play', *player.arguments,
                           '--ros-args', '-r', '__ns:=/robot'],
                          capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert 'no bag' in done.stderr and 'usage' not in done.stderr
