"""Who may do what on the bus: roles, certificates, rules, reasons of refusals, open addresses.

Imports: nothing of ours.
"""
