"""Who may do what on the bus: roles, certificates, the router's rules, why a connection is refused, whom
an address is open to.

Imports: nothing of ours.
"""
