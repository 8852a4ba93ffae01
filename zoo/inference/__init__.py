"""The inference harness: every strategy trains any model and guide; it knows none by name."""
