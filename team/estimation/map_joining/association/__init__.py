"""Which local landmarks of which submaps are one landmark: pure functions on arrays."""
