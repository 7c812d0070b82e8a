//! A port on which the gateway is a Modbus slave: its registers and coils (docs/configuration.md section 4, "Modbus RTU
//! slave").

use proto_core::config::{FieldSpec, GatewayConfig, Recipe, Rs485, Transaction};
use proto_core::modbus::rtu::Table;
use proto_core::sysvar::SysVar;

use crate::oracle::frame::{Frame, device_frame};

/// The slave.
#[derive(Debug, Clone)]
pub(in crate::oracle) struct ServedSpec {
    pub address: u8,
    pub line: Rs485,
    pub blocks: Vec<Block>,
}

/// Registers or coils.
#[derive(Debug, Clone)]
pub(in crate::oracle) struct Block {
    pub table: Table,
    pub first: u16,
    pub count: u16,
    /// The input frame of the port, written by a master.
    pub input: Option<usize>,
    /// The frame that a master reads.
    pub output: Option<Frame>,
}

impl ServedSpec {
    /// The blocks of a recipe, which come after its other input frames; `None` without any.
    pub(in crate::oracle) fn new(
        config: &GatewayConfig,
        recipe: &Recipe,
        line: Rs485,
        inputs: &mut Vec<Frame>,
    ) -> Option<Self> {
        let mut blocks = Vec::new();
        let exchanges = config.view().exchanges_of(recipe);
        for exchange in exchanges {
            let Transaction::Served { operation, written, read } = exchange.transaction else { return None };
            let (table, first, count) = operation.place();
            let frame = |fields: &[FieldSpec]| device_frame(&[], &[], None, fields);
            let mut block = Block { table, first, count, input: None, output: None };
            if written.len > 0 {
                block.input = Some(inputs.len());
                inputs.push(frame(written.of(&config.fields)));
            } else {
                block.output = Some(frame(read.of(&config.fields)));
            }
            blocks.push(block);
        }
        let address = exchanges.first()?.peer;
        Some(Self { address, line, blocks })
    }

    /// The variables that a master reads.
    pub(in crate::oracle) fn shown(&self) -> impl Iterator<Item = SysVar> {
        self.blocks.iter().filter_map(|block| block.output.as_ref()).flat_map(|out| out.shown.iter().copied())
    }

    /// The block that contains this register or coil.
    pub(in crate::oracle) fn block_at(&self, table: Table, at: u16) -> Option<(usize, &Block)> {
        let has = |block: &Block| at.checked_sub(block.first).is_some_and(|nth| nth < block.count);
        self.blocks.iter().enumerate().find(|(_, block)| block.table == table && has(block))
    }
}
