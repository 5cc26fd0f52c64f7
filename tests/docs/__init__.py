"""The site: its pages, what they run, and where they lead."""
