"""Drake simulation of the work cell: station diagram, executor of plans, gripper, recordings."""
