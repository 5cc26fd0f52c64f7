"""Pictures, reports and the viewer's page."""
