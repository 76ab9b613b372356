"""The fault campaign: seeded missions with faults drawn by their seeds, each judged by what it leaves as
evidence.
"""
