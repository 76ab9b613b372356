"""What is wrong with a value that was to become a struct, in words; and values of YAML texts, within limits.

Imports: nothing of ours.
"""
