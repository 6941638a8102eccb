"""PX4 over Zenoh: `px4-zenoh:`, from its own Zenoh module or any publisher of px4_msgs with rmw_zenoh."""
