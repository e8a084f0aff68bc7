"""The simulated arm: a MuJoCo plant behind CANopen joint nodes that answer frames as drives do."""
