"""The worlds that missions fly in: the gas and the wind at a place and a time, and what instruments read.

Imports: plume, plume.mistakes, plume.sensors.
"""
