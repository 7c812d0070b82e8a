//! The table of the templates.

/// A gateway file for a device.
#[derive(Debug)]
pub(super) struct Template {
    pub(super) name: &'static str,
    pub(super) text: &'static str,
}

impl Template {
    /// The device in one line: the first comment of the file.
    pub(super) fn title(&self) -> &'static str {
        self.text.lines().next().map_or("", |line| line.trim_start_matches(['#', ' ']))
    }
}

macro_rules! templates {
    ($($name:literal,)*) => {
        &[$(Template {
            name: $name,
            text: include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/templates/", $name, ".toml")),
        },)*]
    };
}

/// All templates, sorted by name.
pub(super) const ALL: &[Template] = templates![
    "advantech-adam-4017",
    "and-balance",
    "blink-pkp-2400",
    "bota-rokubi",
    "datalogic-quickscan",
    "delta-ms300",
    "dh-pge",
    "dimetix-dls-c",
    "eastron-sdm630",
    "iai-robo-cylinder",
    "inspire-rh56",
    "keyence-sr750",
    "kunwei-kwr75",
    "leadshine-cs2rs",
    "mettler-toledo-sics",
    "omron-e5cc",
    "onrobot-rg2",
    "patlite-nhl",
    "robotiq-2f",
    "robotiq-ft300",
    "sick-ahm36",
    "siemens-s7-1200",
    "waveshare-io-8ch",
    "witmotion-imu",
];
