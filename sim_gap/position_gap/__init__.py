"""The gap of recordings without a torque channel: controller and joints between commanded and measured positions.

`plant` has the user's model as MuJoCo moves it along commands, `windows` cuts recordings into
windows, `simulation` runs them for one hypothesis or many, `fit` and `choice` find parameters and effects, and what
each effect lowers. `training` has the corrected model, its intervals, and its replay.
"""
