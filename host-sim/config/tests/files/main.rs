//! Configuration files as people write them: the examples, those of the documents, wrong and damaged ones.

mod advice;
mod answer_files;
mod bits;
mod counter_files;
mod damaged_files;
mod device_files;
mod document_examples;
mod documented_keys;
mod event_files;
mod example_files;
mod exchange_files;
mod frame_order;
mod framing_files;
mod golden_images;
mod input_rule_files;
mod sendable_files;
mod since;
mod tcp_files;
mod wrong_devices;
mod wrong_exchanges;
mod wrong_files;
