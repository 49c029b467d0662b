"""What `smal match` works on and answers: folders of images, a method with its settings, and a report."""
