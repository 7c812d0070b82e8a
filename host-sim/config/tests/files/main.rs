//! Configuration files as people write them: the examples, those of the documents, wrong and damaged ones.

mod bits;
mod damaged_files;
mod document_examples;
mod example_files;
mod wrong_files;
