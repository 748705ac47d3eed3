"""What a network makes of the states, and the idealised learners in its kernel."""
