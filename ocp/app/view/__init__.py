"""Pictures, reports, and pages that play motions."""
