"""Global search: configurations, the atlas of the self-motion manifold, lower bounds of the cost."""
