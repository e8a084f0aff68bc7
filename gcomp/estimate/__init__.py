"""Estimation: parameters with priors, robust fits, choice of effects by held-out likelihood, intervals.

Arrays in, values out. An `EstimationProblem` says what parameters leave of measurements; rows belong to channels, such
as the joints of an arm, and to blocks, such as recordings, that can be held out.
"""
