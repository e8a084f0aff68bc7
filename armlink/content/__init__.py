"""Content of files from outside, and text that goes out: sizes, budgets, escapes, dumpers, atomic writes."""
