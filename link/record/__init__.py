"""What was said on a bus, written to a file and read back. Imports: link.bus."""
