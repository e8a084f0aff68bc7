"""Position-only diagnosis: the controller and the joints between a commanded and a measured position.

`windows` cuts recordings into windows, `simulate` runs all joints, windows and hypotheses at once, `fit` and `compete`
choose controller and effects, `judge` tells what other effects would do as well. `replay` runs the exported model.
"""
