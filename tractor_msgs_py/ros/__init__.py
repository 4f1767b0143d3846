"""The parts of the wire contract that need a ROS installation. Nothing pure imports this."""
