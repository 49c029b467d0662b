"""What `smal topic` hears: messages, rates, bandwidth, and where the time goes."""
