"""Everything of Zenoh: sessions, the router, the bus, and what is lacking after a cut."""
