"""Settings as parameters of a real node: what is given, what is refused, what is described."""

from __future__ import annotations

import dataclasses
from contextlib import contextmanager
from pathlib import Path
from typing import Iterator

import pytest
import rclpy
from rcl_interfaces.msg import ParameterType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_peer import Process

from aim_slam_ros.config import Config
from aim_slam_ros.nodes.frontend.parameters import FrontendParameters
from aim_slam_ros.nodes.loop_closure.parameters import LoopClosureParameters
from aim_slam_ros.nodes.parameters import declare_config, declare_section, warn_of_unknown
from aim_slam_ros.settings import ConfigError

TYPES = {bool: ParameterType.PARAMETER_BOOL, int: ParameterType.PARAMETER_INTEGER,
         float: ParameterType.PARAMETER_DOUBLE, str: ParameterType.PARAMETER_STRING}
PROGRAM = """
import sys
from rclpy.node import Node
from aim_slam_ros.nodes.loop_closure.parameters import LoopClosureParameters
from aim_slam_ros.nodes.parameters import declare_config, declare_section, warn_of_unknown
from aim_slam_ros.nodes.running import run


def make():
    node = Node('probe')
    print(declare_config(node).camera, declare_section(node, LoopClosureParameters))
    warn_of_unknown(node)
    raise SystemExit(0)


sys.exit(run(make, sys.argv))
"""


@contextmanager
def node(*arguments: str) -> Iterator[Node]:
    """With these words behind --ros-args."""
    context = Context()
    rclpy.init(args=['--ros-args', *arguments], context=context)
    made = Node('probe', context=context)
    try:
        yield made
    finally:
        made.destroy_node()
        context.try_shutdown()


def given(**values: str) -> list[str]:
    """As on the command line; __ stands for the dot."""
    return [word for name, value in values.items()
            for word in ('-p', f'{name.replace("__", ".")}:={value}')]


def test_without_parameters_all_is_default() -> None:
    with node() as probe:
        assert declare_config(probe) == Config()
        assert declare_section(probe, LoopClosureParameters) == LoopClosureParameters()


def test_what_is_given_arrives_in_its_own_type() -> None:
    words = given(seed='7', camera__width='280', camera__min_contrast='3', map_frame='world',
                  model__infer='every_image', publish_tf='false', path_period_s='2',
                  sigma__sigma_ray='1.0e-4')
    with node(*words) as probe:
        config = declare_config(probe)
        section = declare_section(probe, LoopClosureParameters)
        assert probe.get_parameter('camera.min_contrast').type_ is Parameter.Type.DOUBLE
    assert (config.seed, config.camera.width, config.model.infer) == (7, 280, 'every_image')
    assert isinstance(config.camera.min_contrast, float) and config.camera.min_contrast == 3.0
    assert config.sigma.sigma_ray == 1e-4
    assert section == LoopClosureParameters(map_frame='world', publish_tf=False,
                                            path_period_s=2.0)


def test_a_file_and_the_command_line_go_together(tmp_path: Path) -> None:
    file = tmp_path / 'mine.yaml'
    file.write_text('/**:\n  ros__parameters:\n    camera: {width: 280, fov_deg: 90}\n'
                    '    save_directory: /maps\n')
    with node('--params-file', str(file), *given(camera__width='392')) as probe:
        config = declare_config(probe)
        assert (config.camera.width, config.camera.fov_deg) == (392, 90.0)
        assert declare_section(probe, LoopClosureParameters).save_directory == '/maps'


@pytest.mark.parametrize('value, expected', [
    ('abc', 'a multiple of 14 from 84 to 1036'), ('281', 'a multiple of 14'),
    ('70', 'from 84'), ('280.0', 'a multiple'), ('[280]', 'a multiple'), ('true', 'a multiple')])
def test_a_wrong_number_is_refused_by_name(value: str, expected: str) -> None:
    with node(*given(camera__width=value)) as probe:
        with pytest.raises(ConfigError, match=rf'camera\.width: .*{expected}'):
            declare_config(probe)


@pytest.mark.parametrize('name, value, expected', [
    ('map_frame', '3', 'text'), ('publish_tf', '1', 'true or false'),
    ('path_period_s', '.nan', 'a number from 0.1 to 3600'), ('path_period_s', '0', 'from 0.1'),
    ('map_frame', "''", 'map_frame and odom_frame'), ('odom_frame', 'map', 'different')])
def test_a_wrong_value_of_a_node_is_refused(name: str, value: str, expected: str) -> None:
    with node(*given(**{name: value})) as probe:
        with pytest.raises(ConfigError, match=expected) as refused:
            declare_section(probe, LoopClosureParameters)
        assert name in str(refused.value)


def test_a_choice_is_refused_with_the_choices() -> None:
    with node(*given(tracking__tracker='best')) as probe:
        with pytest.raises(ConfigError, match='tracking.tracker: .*one of image, paper'):
            declare_config(probe)


def test_every_parameter_says_what_it_is_and_stays() -> None:
    with node() as probe:
        declare_config(probe)
        declare_section(probe, LoopClosureParameters)
        specs = Config().settings() | {f.name: f for f in dataclasses.fields(
            LoopClosureParameters)}
        for name, spec in specs.items():
            descriptor = probe.describe_parameter(name)
            assert descriptor.description == spec.metadata['doc'] and descriptor.read_only
            assert descriptor.type == TYPES[type(spec.default)], name
            ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
            assert len(ranges) == (spec.metadata['low'] is not None), name
        width = probe.describe_parameter('camera.width').integer_range[0]
        assert (width.from_value, width.to_value, width.step) == (84, 1036, 14)
        assert 'image, paper' in probe.describe_parameter(
            'tracking.tracker').additional_constraints
        changed, = probe.set_parameters([Parameter('camera.width', value=392)])
        assert not changed.successful


def test_both_nodes_take_their_sections_together() -> None:
    """Their names must not collide with each other's or with the settings'."""
    own = [{f.name for f in dataclasses.fields(section)}
           for section in (FrontendParameters, LoopClosureParameters)]
    shared = own[0] & own[1]
    assert not (own[0] | own[1]) & set(Config().settings())
    for name in shared:     # one value serves both
        assert getattr(FrontendParameters(), name) == getattr(LoopClosureParameters(), name)


@pytest.mark.parametrize('arguments, status, said', [
    (given(camera__width='392', image_transport='raw'), 0, 'width=392'),
    (given(camera__widht='392'), 0,
     'parameter camera.widht does not exist and is ignored; did you mean camera.width'),
    (given(camera__width='wide'), 2, "error: camera.width: 'wide' is not allowed")])
def test_a_person_is_told(tmp_path: Path, arguments: list[str], status: int, said: str) -> None:
    (tmp_path / 'program.py').write_text(PROGRAM)
    with Process(tmp_path / 'log', 'program', '--ros-args', *arguments) as process:
        assert process.ended() == status
        assert said in process.output and 'Traceback' not in process.output


def test_parameters_of_the_other_node_are_no_mistake(capfd: pytest.CaptureFixture[str]) -> None:
    """One file serves both."""
    with node(*given(image_transport='raw', no_such='1')) as probe:
        declare_section(probe, LoopClosureParameters)
        warn_of_unknown(probe, FrontendParameters)
    said = capfd.readouterr().err
    assert 'no_such' in said and 'image_transport' not in said
