"""What a fit is, and the iterations that lead to one."""
