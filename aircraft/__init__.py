"""What flies, as the search sees it: the interface of a vehicle, and the words of all who deal with one.

Imports: plume, link, link.bus.
"""
