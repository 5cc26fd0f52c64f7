"""Pictures, plots and HTML reports of motions, and HTML pages that play motions."""
