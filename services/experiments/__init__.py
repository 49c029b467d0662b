"""What is measured with the method: evaluation, matching of image folders, showing what was learned."""
