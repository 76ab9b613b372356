"""What commands share: flags, tables on a terminal, files written whole; and the page that documents the bus. Imports: link.bus."""
