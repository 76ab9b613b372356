"""Missions shown live. Imports: scene."""
