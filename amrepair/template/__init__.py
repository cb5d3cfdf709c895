"""Template: the part as it should be, as a signed distance field.

Learned, exact or planned from G-code, all behind one port. It knows nothing of scans' poses.
"""
