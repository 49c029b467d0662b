"""The page in a real browser, with one stack for all tests."""
