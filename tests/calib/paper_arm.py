"""The reference arm of the paper, as numbers."""

NAMES = tuple(f"joint_{i}" for i in range(1, 8))
BETA = (
    0.1116,
    -0.9594,
    -0.1063,
    -4.6877,
    0.1256,
    -1.0284,
    0.0437,
    1.5219,
    0.0376,
    0.0871,
    -0.0217,
    0.6686,
    0.1132,
    -0.0594,
)
