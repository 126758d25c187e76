"""A ROS 2 node around an exported controller."""
