"""From a model or a bus to an arm file that works, and what is doubtful about one that does not."""
