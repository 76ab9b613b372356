"""Records: the messages of a bus, written to a file and read back. Imports: link, link.bus."""
