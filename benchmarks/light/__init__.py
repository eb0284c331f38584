"""Questions about the light: what a photo tells of it, and what the loop finds again."""
