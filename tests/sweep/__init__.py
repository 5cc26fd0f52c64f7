"""Random families of problems whose optimum is known: does the audit pass the optima, and nothing else?

``make sweep`` runs all of it; ``python -m tests.sweep --only FAMILY --seed N`` one problem again, with its tables.
"""
