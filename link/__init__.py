"""The bus in commands: the flags they share, and the page that documents the bus. Imports: link.bus."""
