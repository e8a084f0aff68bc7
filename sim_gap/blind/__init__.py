"""The blind check: sealed cases from an independent simulator, and the score of the diagnosis on them."""
