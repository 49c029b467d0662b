"""The scripted expert: a client that sees the true pose and drives as a person with four keys would."""
