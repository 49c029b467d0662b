"""What `smal tune` searches and answers."""
