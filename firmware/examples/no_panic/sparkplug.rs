//! The edge node: input from a broker and a time server, settings, samples.

use core::hint::black_box;

use proto_core::config::GatewayConfig;
use proto_core::time::{Duration, Instant};
use recipe_sparkplug::catalog::{Catalog as _, Owner};
use recipe_sparkplug::document::NodeDocument;
use recipe_sparkplug::gateway::{GatewayCatalog, Rates};
use recipe_sparkplug::node::{EdgeNode, Input, MIN_BUFFER, NodeCounters};
use recipe_sparkplug::sntp::Sntp;
use recipe_sparkplug::value::Value;
use static_cell::ConstStaticCell;

use crate::{any, bytes, out_buf};

type SmallEngine = proto_core::engine::Engine<2, 1, 32, 0, 4>;
type SmallCatalog = GatewayCatalog<'static, 64>;
type SmallNode = EdgeNode<64, 16>;

pub(crate) fn all() {
    static DOCUMENT: ConstStaticCell<NodeDocument> = ConstStaticCell::new(NodeDocument::empty());
    static NODE: ConstStaticCell<SmallNode> = ConstStaticCell::new(SmallNode::idle());
    static ENGINE: ConstStaticCell<SmallEngine> = ConstStaticCell::new(SmallEngine::idle());
    static CONFIG: GatewayConfig = GatewayConfig::empty();
    sparkplug_time();
    let (Some(document), Some(node), Some(engine)) =
        (DOCUMENT.try_take(), NODE.try_take(), ENGINE.try_take())
    else {
        return;
    };
    sparkplug_document(black_box(&mut *document));
    let _ = black_box(black_box(&mut *engine).configure(black_box(&CONFIG)));
    let document: &'static NodeDocument = document;
    if let Some(catalog) = sparkplug_catalog(document, black_box(engine), &CONFIG) {
        sparkplug_sample(black_box(&catalog), black_box(engine));
        if node.configure(&document.settings, black_box(&catalog), any(None), any(1)).is_ok() {
            sparkplug_node(black_box(node), black_box(&catalog));
        }
    }
}

#[inline(never)]
fn sparkplug_time() {
    let mut sntp = Sntp::new(any(1));
    let sntp = black_box(&mut sntp);
    black_box((sntp.poll(any(Instant::ZERO)), sntp.deadline(), sntp.counters()));
    let _ = black_box(sntp.receive(any(Instant::ZERO), bytes()));
}

#[inline(never)]
fn sparkplug_document(document: &mut NodeDocument) {
    let _ = black_box(document.decode(bytes()));
    let mut out = [0; 256];
    let _ = black_box(document.encode(out_buf(&mut out)));
}

#[inline(never)]
fn sparkplug_catalog(
    document: &'static NodeDocument,
    engine: &SmallEngine,
    config: &'static GatewayConfig,
) -> Option<SmallCatalog> {
    let rates = Rates {
        min_interval: document.interval,
        counter_interval: document.counter_interval,
        rules: &document.rules,
        values: &document.values,
    };
    SmallCatalog::new(black_box(config).view(), engine.status(any(Instant::ZERO)), rates, "0").ok()
}

#[inline(never)]
fn sparkplug_sample(catalog: &SmallCatalog, engine: &SmallEngine) {
    let mut values = [None; 64];
    let status = engine.status(any(Instant::ZERO));
    let counters = any(NodeCounters::NONE);
    let part = any(0)..any(64);
    catalog.sample_part(status, any(Duration::ZERO), &counters, part, black_box(&mut values[..]));
    black_box((values, catalog.alive(status), catalog.len()));
    black_box((catalog.metric(any(1)), catalog.report(any(1)), catalog.metrics(any(Owner::Node))));
}

#[inline(never)]
fn sparkplug_node(node: &mut SmallNode, catalog: &SmallCatalog) {
    let now = any(Instant::ZERO);
    let values: [Option<Value>; 64] = any([None; 64]);
    for input in [
        Input::Opened,
        Input::Closed,
        Input::Bytes(bytes()),
        Input::Sample { values: any(&values[..]), alive: any(1) },
        Input::Values { first: any(1), values: any(&values[..]) },
        Input::Sampled { alive: any(1) },
        Input::Time { utc_ms: any(1) },
        Input::End,
    ] {
        node.handle(now, any(input), catalog);
    }
    let mut piece = [0; MIN_BUFFER];
    black_box(node.poll_output(now, catalog, out_buf(&mut piece)));
    black_box((node.counters(), node.failure(), node.is_online(), node.bd_seq()));
}
