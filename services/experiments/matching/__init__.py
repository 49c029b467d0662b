"""Parts of `smal match`: sources of images, features, ground truth and reports."""
