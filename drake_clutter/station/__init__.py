"""Drake simulation of the work cell: station, plan executor, gripper, recordings."""
