"""Inside of `smal.state_matching`: a working set of template frames, Newton's method on it, and the certificate.

From the outside in: `working_set` grows the set; `block_newton` solves Eq. 7 on it (`newton_direction`,
`block_problem`); `screening` extends its dual point to all sequences and rules nearly all of them out (`certificate`).
Inner products come from `template_products`, from `template_index` (an eight-bit copy of the templates), or as a stream
(`streaming`, with `frame_ring` and `streamed_products`).
"""
