"""The bridge: joins the bus with MAVLink endpoints over UDP, TCP and serial lines.

Imports: link, link.access, link.bus, link.signing.
"""
