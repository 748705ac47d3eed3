"""Where policies go and how long that takes: occupancy, covering, mixing, exploration."""
