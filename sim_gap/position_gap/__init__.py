"""The gap of recordings without a torque channel: controller and joints between commanded and measured positions."""
