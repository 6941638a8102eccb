"""PX4 over Zenoh: `px4-zenoh:`, from PX4's Zenoh module or any publisher of px4_msgs over rmw_zenoh."""
