"""The public suites of optimal control problems: one module a problem, and the table of what is known of each."""
