"""The ament_python package; pinned third-party versions stand in requirements.txt."""

from glob import glob
from typing import Any

from setuptools import find_packages, setup
from setuptools.command.develop import develop

NAME = 'aim_slam_ros'


class Develop(develop):
    """What `colcon build --symlink-install` calls; it does not heed [build_scripts] executable."""

    def write_script(self, name: str, contents: str, *mode: Any) -> None:
        body = contents.partition('\n')[2]
        super().write_script(name, f'#!/usr/bin/env python3\n{body}', *mode)


setup(
    name=NAME,
    version='0.2.0',
    description='AIM-SLAM for ROS 2: dense monocular SLAM around a geometry foundation model',
    author='aim_slam_ros developers',
    maintainer='aim_slam_ros developers',
    maintainer_email='maintainers@aim-slam-ros.invalid',
    license='Apache-2.0',
    python_requires='>=3.11',
    packages=find_packages(include=[NAME, f'{NAME}.*', 'msg_adapters', 'msg_adapters.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *[(f'share/{NAME}/{folder}', files) for folder, files in (
            ('config', [file for kind in ('yaml', 'rviz', 'xml')
                        for file in sorted(glob(f'config/*.{kind}'))]),
            ('launch', sorted(glob('launch/*.launch.py'))))],
    ],
    install_requires=['setuptools'],
    extras_require={'weights': ['huggingface_hub']},
    zip_safe=True,
    cmdclass={'develop': Develop},
    entry_points={'console_scripts': [
        f'{name} = {NAME}.cli.{name}:main'
        for name in ('frontend', 'loop_closure', 'slam', 'ablate', 'calibrate', 'convert',
                     'demo', 'download_weights', 'evaluate', 'play')]},
)
