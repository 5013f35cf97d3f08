"""Frontend and loop closure, and RViz if asked for.

    ros2 launch aim_slam_ros aim_slam.launch.py image:=/camera/image_raw rviz:=true

An argument that is empty leaves what the parameter files say.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = 'aim_slam_ros'
ARGUMENTS = {   # name: (default, meaning)
    'image': ('image', 'topic of the images; compressed ones are looked for at IMAGE/compressed'),
    'camera_info': ('', 'topic of the calibration; empty: camera_info beside the images'),
    'image_transport': ('', 'raw or compressed'),
    'model': ('', 'the geometry model'),
    'weights': ('', "file with the model's weights"),
    'namespace': ('', 'namespace of the nodes and their topics'),
    'map_frame': ('', 'frame of everything corrected'),
    'odom_frame': ('', 'frame of pose and odometry, which never jumps'),
    'base_frame': ('', "the robot's frame, if TF knows the camera in it"),
    'camera_frame': ('', "the camera's optical frame, if the images do not name it"),
    'params_file': ('', 'parameter file that is read after config/*.yaml of this package'),
    'log_level': ('info', 'debug, info, warn, error or fatal'),
}
SWITCHES = {
    'use_sim_time': ('false', 'take the time from /clock, as when a bag is played'),
    'loop_closure': ('true', 'start the loop-closure node; without it there is no map frame'),
    'single_process': ('false', 'both nodes in one process, which share one model'),
    'rviz': ('false', 'start RViz with a view of everything that is published'),
    'shared_memory': ('false', 'use config/fastdds_shm.xml, which holds whole images; start the '
                               'camera with it too'),
}
BOTH = {'model': 'model.name', 'weights': 'model.weights',
        'map_frame': 'map_frame', 'odom_frame': 'odom_frame'}
FRONTEND = {**BOTH, 'image_transport': 'image_transport', 'base_frame': 'base_frame',
            'camera_frame': 'camera_frame'}


def generate_launch_description() -> LaunchDescription:
    """Arguments, then the nodes, which depend on them."""
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=meaning)
          for name, (default, meaning) in ARGUMENTS.items()),
        *(DeclareLaunchArgument(name, default_value=default, description=meaning,
                                choices=['true', 'false'])
          for name, (default, meaning) in SWITCHES.items()),
        OpaqueFunction(function=_started)])


def _started(context: LaunchContext) -> list:
    """What the arguments ask for."""
    given = {name: context.launch_configurations[name] for name in (*ARGUMENTS, *SWITCHES)}
    on = {name for name in SWITCHES if given[name] == 'true'}
    share = Path(get_package_share_directory(PACKAGE))
    out = []
    if 'shared_memory' in on:
        out.append(SetEnvironmentVariable('FASTRTPS_DEFAULT_PROFILES_FILE',
                                          str(share / 'config' / 'fastdds_shm.xml')))
    if {'loop_closure', 'single_process'} <= on:
        out.append(_node(given, share, ['frontend', 'loop_closure'], FRONTEND, executable='slam'))
    else:
        out.append(_node(given, share, ['frontend'], FRONTEND, name='frontend',
                         executable='frontend'))
        if 'loop_closure' in on:
            out.append(_node(given, share, ['loop_closure'], BOTH, name='loop_closure',
                             executable='loop_closure'))
    if 'rviz' in on:
        out.append(_rviz(given, share))
    return out


def _node(given: dict, share: Path, files: list, parameters: dict, **kind: str) -> Node:
    """One process. ``slam`` gets no name: that would rename both of its nodes."""
    chosen = {parameter: ParameterValue(given[argument], value_type=str)
              for argument, parameter in parameters.items() if given[argument]}
    return Node(
        package=PACKAGE, namespace=given['namespace'], output='screen', **kind,
        parameters=[*(str(share / 'config' / f'{file}.yaml') for file in files),
                    *([given['params_file']] if given['params_file'] else []),
                    {**chosen, 'use_sim_time': given['use_sim_time'] == 'true'}],
        remappings=_remappings(given), ros_arguments=['--log-level', given['log_level']])


def _remappings(given: dict) -> list:
    image = given['image']
    beside = f'{image.rpartition("/")[0]}/camera_info' if '/' in image else 'camera_info'
    return [('image', image), ('image/compressed', f'{image}/compressed'),
            ('camera_info', given['camera_info'] or beside)]


def _rviz(given: dict, share: Path) -> Node:
    """Topics in the view are relative: RViz stands in the namespace of the nodes."""
    return Node(
        package='rviz2', executable='rviz2', namespace=given['namespace'],
        arguments=['-d', str(share / 'config' / 'aim_slam.rviz'),
                   *(['-f', given['map_frame']] if given['map_frame'] else [])],
        parameters=[{'use_sim_time': given['use_sim_time'] == 'true'}],
        remappings=_remappings(given))
