"""Work cell as data: robot, gripper, support, cameras and fixtures."""
