"""What all commands share of talking on a bus: their flags, and the page that documents the bus. Imports: link.bus."""
