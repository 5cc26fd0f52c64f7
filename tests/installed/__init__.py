"""The wheel as a new user has it: in an environment of its own, outside the repository, through the command alone.

`make installed` runs it; it takes minutes, most of them for what is downloaded.
"""
