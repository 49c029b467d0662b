"""A driving stack under kills, freezes, outages, a full disk, a client that does not read, and floods."""
