"""Those who race: one module each, written as a careful user of that library would write it."""
