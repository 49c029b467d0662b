"""How long a decision takes on a long way."""
