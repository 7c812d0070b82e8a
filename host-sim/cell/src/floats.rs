//! Unreadable values: NaN or infinity in state packets and recipe frames of the controller.

use proto_core::config::{FieldSpec, Parts, StreamPart};
use proto_core::engine::LinkId;
use proto_core::sysvar::SysVar;
use proto_core::wire::scalar::ScalarType;

use super::{Cell, Entry, What};

impl Cell {
    /// From now on, the controller sends `value` for this variable, whatever its register contains.
    pub fn corrupt_float(&mut self, var: SysVar, value: f32) {
        self.trace.add(self.now, What::Fault, Entry::CONTROLLER, &value.to_le_bytes());
        // Does nothing if the variable is not a float.
        let _ = self.controller_mut().corrupt(&var.to_string(), value);
        self.note_fault(None);
    }

    /// From now on, the controller sends the value of the register again.
    pub fn heal(&mut self, var: SysVar) {
        self.trace.add(self.now, What::Fault, Entry::CONTROLLER, &[]);
        let _ = self.controller_mut().heal(&var.to_string());
        self.note_fault(None);
    }

    /// The float variables in the gateway's configuration.
    pub fn floats(&self) -> Vec<SysVar> {
        let named = |var: &SysVar| {
            self.gateway.fields.iter().any(|field| field.variables().any(|bound| bound == *var))
        };
        SysVar::all().filter(|var| var.ty() == ScalarType::Float && named(var)).collect()
    }

    /// Length of the controller's frames to a port where the gateway listens; `None` if it sends none.
    pub(super) fn frame_len(&self, link: LinkId) -> Option<usize> {
        let port = self.gateway.ports.get(usize::from(link.port()?.0))?;
        let recipe = self.gateway.recipes.get(usize::from(port.recipe))?;
        let Parts::Stream { output: Some(StreamPart { head, fields, tail, .. }), .. } = &recipe.parts else {
            return None;
        };
        let fields = fields.of(&self.gateway.fields).iter().filter_map(FieldSpec::variable);
        Some(head.len() + fields.map(SysVar::size).sum::<usize>() + tail.len())
    }
}
