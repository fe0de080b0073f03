"""What accuracy costs: the knobs that are swept, what each is compared with, and what is made of the rows."""
