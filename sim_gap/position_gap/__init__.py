"""The gap of recordings without a torque channel: controller and joints between commanded and measured positions.

`windows` cuts recordings into windows, `simulate` runs all joints, windows and hypotheses at once, `fit` and
`selection` choose controller and effects, `judge` says what each effect lowers and what others would do as well.
`training` has the corrected model, its intervals, and its replay.
"""
