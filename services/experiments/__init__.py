"""What is measured with the method: evaluation, tuning, matching of image folders."""
