"""Who may do what on the bus: roles, certificates, the router's rules, and why a connection is refused. Imports: nothing of ours."""
