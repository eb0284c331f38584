"""Evaluation of estimated cameras on photographs whose camera is known; nothing is rendered."""
