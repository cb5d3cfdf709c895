"""Field: what scans say of the space around a part, as sums over cells, and their local means.

It holds observations and measures them; it knows no tolerance and labels nothing.
"""
