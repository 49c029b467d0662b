"""Time of a match over one product X^T Y, against Algorithm 2 and CVXPY."""
