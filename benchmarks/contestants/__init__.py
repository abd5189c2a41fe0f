"""The contestants, one module each, written as a careful user of that library would write it."""
