"""A real browser opens what people open: pages of `selfmotion view`, written and served, and those of the site.

`make browser` runs it; no test needs it.
"""
