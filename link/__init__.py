"""What commands share: flags, tables, files written whole, certificates, modes; and the page of the bus.
Imports: link.access, link.bus.
"""
