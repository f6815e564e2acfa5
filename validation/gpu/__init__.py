"""What the devices of this machine cost for a frame, and how their frames differ."""
