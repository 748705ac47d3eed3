"""Files, locks, memory, arrays in files, code of the user's own and the text of messages: what every part rests on."""
