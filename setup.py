"""The ament_python package; pinned third-party versions stand in requirements.txt."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'aim_slam_ros'

setup(
    name=NAME,
    version='0.1.0',
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
            ('config', sorted(glob('config/*.yaml'))),
            ('launch', sorted(glob('launch/*.launch.py')))) if files],
    ],
    install_requires=['setuptools'],
    zip_safe=True,
    entry_points={'console_scripts': [f'evaluate = {NAME}.cli.evaluate:main']},
)
