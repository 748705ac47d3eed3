"""The built-in worlds: a file for each class, with its rules, its look and its named instances."""
