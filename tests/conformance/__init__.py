"""Problems whose optimum is known: each module holds a statement and, beside it, its answer."""
