"""Every threshold of the observer in motion, with its unit; calib.observer.config has those that both observers share.

tests/campaigns/moving_arms.py bounds the result: changes found, changes not found, and none where there is none.
"""

# stretches of motion (passages)
WIDTH = 0.1
"""A stretch is complete when some joint has moved this far [rad]: two or three periods of a motor's cogging."""
LEAST_SECONDS, MOST_SECONDS = 0.2, 3.0
"""Shortest and longest stretch [s]: a slower joint creeps below the speeds at which its friction is known."""
LEAST_SAMPLES = 8
SLOWEST = 0.03
"""Below this speed friction depends on the time at rest [rad/s]: such a joint gives no row."""
STEADY = 0.15
"""Largest acceleration in a stretch [rad/s²]: 1 kg·m² then takes 0.15 N·m."""
TURNED = 0.03
"""After a reversal friction has turned round once the joint has moved so far [rad]."""
GAP = 0.05
"""A stretch with samples missing for longer starts again [s]."""

# what is believed of a drive
ZERO_STD = 2e-3
"""Least standard deviation of a position zero [rad]: links give way."""
SIGMA_SHARE = 2e-3
"""Standard deviation of a row about the model where the record has none, as a share of rated torque."""
USUAL_ROWS = 5
"""Rows that the standard deviation assumed at first counts for; then it is measured."""
ALIKE = 2.0
"""The variance of rows is multiplied by this to begin with: what the model lacks is alike in neighbouring rows. Then it
is measured."""
FITTED = 5
"""Rows of a joint that its own parameters take up."""
NEXT = 0.2
"""Rows of a joint are neighbours if it moved less between them [rad]."""
LEARNING_ROUNDS = 3
"""Linearisations of learning, each with the scatter found by the one before."""
UNTOLD_WARMTH = 0.01
"""Doubt of a gain where no temperature is known: a drive that warms by 10 K loses a hundredth."""
TOLD_WARMTH = 5e-4
"""Doubt of a gain where it is: drives tell whole kelvins."""

# test for a change
FEWEST = 6
"""Rows of a joint from which a change of its drive can be told."""
MISFIT = 8.0
"""χ² above its degrees of freedom, in standard deviations, from which nothing explains the rows: 120 rows then scatter
by 1.4 times what was learned. Friction of a joint is never quite what it was; a contact is far beyond."""
INEXACT = 0.03
"""Most that a change's own shape may be off, as a share."""
PAYLOAD_ROUNDS = 2
"""Further linearisations of a payload."""

# verdicts
BLOCK = 60
"""Rows of one test: of seven joints that creep in turn, 40 s."""
REFERENCE = 360
"""Rows without a change that the belief is learned from: four minutes of creeping."""
LONGEST = 120
"""Rows of a test at most: the latest."""
AGREEING = 2
"""Tests in a row that must say the same until it is an event."""
UNEXPLAINED = 3
"""The same of tests that nothing explains: the first ones after a change have rows of before it."""
