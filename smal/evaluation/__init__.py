"""How well the method does: ground truth, precision and recall, success rates, and peers to compare with."""
