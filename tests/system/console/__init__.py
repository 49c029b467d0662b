"""What a person does on the page, in a real browser, with one stack for all of it."""
