"""Everything of Zenoh: sessions, the router, the bus, and the recovery of lost samples."""
