//! Values of the controller that cannot be read: not a number, or infinite, in its state packets and
//! recipe frames.

use proto_core::config::{Bus, FieldSpec, Parts, Recipe, StreamPart};
use proto_core::engine::{LinkId, PortId};
use proto_core::sysvar::SysVar;
use proto_core::wire::scalar::ScalarType;

use super::{Cell, Entry, What};

impl Cell {
    /// What the controller sends of this variable is `value` from now on, whatever it has.
    pub fn spoil(&mut self, var: SysVar, value: f32) {
        self.trace.add(self.now, What::Fault, Entry::CONTROLLER, &value.to_le_bytes());
        self.spoilt.insert(var, value);
        self.disturb(None);
    }

    /// It sends what it has.
    pub fn heal(&mut self, var: SysVar) {
        self.trace.add(self.now, What::Fault, Entry::CONTROLLER, &[]);
        self.spoilt.remove(&var);
        self.disturb(None);
    }

    /// The floats that the gateway's configuration names.
    pub fn floats(&self) -> Vec<SysVar> {
        let named = |var: &SysVar| self.gateway.fields.iter().any(|field| field.variable() == Some(*var));
        SysVar::all().filter(|var| var.ty() == ScalarType::Float && named(var)).collect()
    }

    fn link_recipes(&self) -> impl Iterator<Item = (LinkId, &Recipe)> {
        let config = &self.gateway;
        let own = config.controller.recipe_link.map(|link| (LinkId::RECIPE_UDP, link.recipe));
        let listening = config.ports.iter().zip(0..).filter_map(|(port, nth)| match port.bus {
            Bus::TcpListen { .. } | Bus::UdpListen { .. } => {
                Some((LinkId::of_port(PortId(nth)), port.recipe))
            }
            _ => None,
        });
        let recipes = own.into_iter().chain(listening);
        recipes.filter_map(|(link, nth)| Some((link, config.recipes.get(usize::from(nth))?)))
    }

    /// How long the controller's frames of this link are; `None` when it sends none.
    pub(super) fn frame_len(&self, link: LinkId) -> Option<usize> {
        let (_, recipe) = self.link_recipes().find(|(id, _)| *id == link)?;
        let Parts::Stream { output: Some(StreamPart { head, fields, tail }), .. } = &recipe.parts else {
            return None;
        };
        let fields = fields.of(&self.gateway.fields).iter().filter_map(FieldSpec::variable);
        Some(head.len() + fields.map(SysVar::size).sum::<usize>() + tail.len())
    }

    /// A state packet as it is sent.
    pub(super) fn spoil_packet(&self, packet: &mut [u8]) {
        for (var, value) in &self.spoilt {
            let Some(place) = var.stream() else { continue };
            put(packet, usize::from(place.offset), *value);
        }
    }

    /// A frame of a recipe link as it is sent.
    pub(super) fn spoil_frame(&self, link: LinkId, frame: &mut [u8]) {
        if self.spoilt.is_empty() {
            return;
        }
        let recipe = self.link_recipes().find(|(id, _)| *id == link).map(|(_, recipe)| recipe);
        let Some(Parts::Stream { output: Some(StreamPart { head, fields, tail }), .. }) =
            recipe.map(|recipe| &recipe.parts)
        else {
            return;
        };
        let mut places = Vec::new();
        let mut at = head.len();
        for field in fields.of(&self.gateway.fields) {
            let FieldSpec::System(var) = field else { return };
            places.extend(self.spoilt.get(var).map(|value| (at, *value)));
            at += var.size();
        }
        // The controller may have another recipe at its port.
        if frame.len() == at + tail.len() {
            places.into_iter().for_each(|(at, value)| put(frame, at, value));
        }
    }
}

fn put(bytes: &mut [u8], at: usize, value: f32) {
    if let Some(place) = bytes.get_mut(at..at + 4) {
        place.copy_from_slice(&value.to_le_bytes());
    }
}
