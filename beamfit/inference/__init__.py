"""Statistics that know nothing about beams: what data determine, and quantities with errors."""
