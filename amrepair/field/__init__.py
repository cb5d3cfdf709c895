"""Field: what scans say of the space around a part, as sums over cells, and their local means.

The room holds observations and averages over them; it knows no tolerance and labels nothing.
`fused` condenses a scan to surface cells (surfels), `scales` forms local means of their deviations
over wider and wider windows, and `as_built` says of any point in space whether it is empty or
solid. `places`, `near` and `groups` answer questions of neighbourhood for the whole package.
"""
