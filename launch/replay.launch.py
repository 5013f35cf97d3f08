"""Both nodes, and a bag played to them.

    ros2 launch aim_slam_ros replay.launch.py bag:=FOLDER image:=camera/image_raw rviz:=true

Takes every argument of aim_slam.launch.py too. The nodes live by the bag's time.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'aim_slam_ros'


def generate_launch_description() -> LaunchDescription:
    """The nodes come first: the player waits for a subscriber of the images."""
    return LaunchDescription([
        DeclareLaunchArgument('bag', description='folder of a rosbag2, or an .mcap, .db3 or '
                                                 '(ROS 1) .bag file'),
        DeclareLaunchArgument('rate', default_value='1.0', description='times real time'),
        DeclareLaunchArgument('start_offset', default_value='0.0',
                              description='begin so many seconds into the bag'),
        DeclareLaunchArgument('loop', default_value='false', choices=['true', 'false'],
                              description='begin again at the end'),
        DeclareLaunchArgument('clock', default_value='100.0',
                              description="how often the bag's time is published [Hz]"),
        DeclareLaunchArgument('use_sim_time', default_value='true', choices=['true', 'false'],
                              description='take the time from /clock'),
        IncludeLaunchDescription(PythonLaunchDescriptionSource(PathJoinSubstitution(
            [FindPackageShare(PACKAGE), 'launch', 'aim_slam.launch.py']))),
        OpaqueFunction(function=_player)])


def _player(context: LaunchContext) -> list:
    given = context.launch_configurations
    return [Node(
        package=PACKAGE, executable='play', namespace=given['namespace'], output='screen',
        arguments=[given['bag'], '--rate', given['rate'], '--clock', given['clock'],
                   '--start-offset', given['start_offset'],
                   *(['--loop'] if given['loop'] == 'true' else [])])]
