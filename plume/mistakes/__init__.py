"""What is wrong with a value that was to become a struct, in words.

Imports: nothing of ours.
"""
