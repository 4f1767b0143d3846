"""The paper's study: every algorithm, table and figure again, beside the printed values."""
