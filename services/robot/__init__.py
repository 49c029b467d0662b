"""What drives anything with wheels: which command is obeyed, and when an episode ends."""
