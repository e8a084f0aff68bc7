"""Files for training: MJCF with native actuators, draws of the parameters, and the replay that checks them."""
