"""Settings are checked before any work starts."""

from __future__ import annotations

import dataclasses

import pytest
import yaml

from aim_slam_ros.config import CameraConfig, Config
from aim_slam_ros.settings import ConfigError, allowed


def test_values_are_set_by_name_and_others_stay() -> None:
    config = Config().with_values({'camera.width': '392', 'seed': '7',
                                   'model.infer': 'every_image',
                                   'camera.use_calibration': 'true'})
    assert (config.camera.width, config.seed, config.model.infer) == (392, 7, 'every_image')
    assert config.camera.use_calibration is True
    assert config.classical == Config().classical
    assert Config().camera.width == 518


def test_a_whole_number_is_good_for_a_float() -> None:
    fov = Config().with_values({'camera.fov_deg': '70'}).camera.fov_deg
    assert isinstance(fov, float) and fov == 70.0
    assert Config().with_values({'camera.min_contrast': '1e-3'}).camera.min_contrast == 0.001


@pytest.mark.parametrize('name, text, expected', [
    ('camera.width', '10', 'a multiple of 14 from 84 to 1036'),
    ('camera.width', '392.5', 'a multiple of 14'),
    ('camera.width', 'wide', 'a multiple of 14'),
    ('camera.width', '500', 'a multiple of 14'),
    ('classical.planes', 'true', 'a whole number'),
    ('camera.fov_deg', '.nan', 'a number from 20 to 140'),
    ('camera.fov_deg', '.inf', 'a number from 20 to 140'),
    ('camera.use_calibration', '1', 'true or false'),
    ('model.name', 'magic', 'one of classical'),
    ('model.name', '[', 'cannot be read'),
    ('seed', '-1', 'a whole number from 0 to 2147483647'),
])
def test_a_wrong_value_is_refused_with_what_is_allowed(name: str, text: str,
                                                       expected: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        Config().with_values({name: text})
    assert name in str(refusal.value) and expected in str(refusal.value)


@pytest.mark.parametrize('name', ['camra.width', 'camera.wdith', 'camera', '', 'to_yaml.x',
                                  'camera.width.x'])
def test_an_unknown_setting_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match='there is no such setting'):
        Config().with_values({name: '1'})


def test_the_nearest_name_is_suggested() -> None:
    with pytest.raises(ConfigError, match='camera.width'):
        Config().with_values({'camera.wdith': '392'})


def test_a_section_checks_itself() -> None:
    with pytest.raises(ConfigError, match='camera.width'):
        CameraConfig(width=1)


def test_every_setting_is_documented_and_its_default_allowed() -> None:
    settings = Config().settings()
    assert {'seed', 'camera.width', 'model.name'} <= set(settings)
    for name, spec in settings.items():
        assert spec.metadata['doc'], name
        assert allowed(spec), name
        text = yaml.safe_dump(spec.default).split('\n')[0]
        assert Config().with_values({name: text}) == Config(), name


def test_the_resolved_configuration_reads_back() -> None:
    config = Config().with_values({'camera.width': '392'})
    assert yaml.safe_load(config.to_yaml()) == dataclasses.asdict(config)
