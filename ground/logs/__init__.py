"""Logs of others: tables of positions, gas and wind (CSV), read as the readings of a search.

Imports: plume, link, link.bus, link.record, ground.tlog.
"""
