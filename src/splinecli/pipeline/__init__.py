"""What a command does with one capture or many, without a terminal."""
