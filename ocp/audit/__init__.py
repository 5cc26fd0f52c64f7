"""The audit: does a plan do what it says, between its nodes too, and is it an extremal?"""
