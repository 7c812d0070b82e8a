//! The pages on formats and rules that comments cite, such as `docs/wire/recipes.md section 4`: the same files as in
//! the package's folder `docs/`. They are included only when documentation is built.

/// Includes a page of `docs/wire/` as a module. If a page defines the same link as here, the first definition counts;
/// the one at the end of the page is for readers of the file.
macro_rules! page {
    ($name:ident: $($link:ident)*) => {
        $(#[doc = concat!("[", stringify!($link), "]: ", stringify!($link))])*
        #[doc = ""]
        #[allow(rustdoc::broken_intra_doc_links, reason = "`DigitalOutputCommand[3]` is a name")]
        #[doc = include_str!(concat!("../docs/wire/", stringify!($name), ".md"))]
        pub mod $name {}
    };
}

/// [driver]: driver
/// [wire]: wire
/// [command]: wire::command
#[doc = ""]
#[doc = include_str!("../docs/engine.md")]
pub mod engine {}

/// [engine]: engine
#[doc = ""]
#[doc = include_str!("../docs/driver.md")]
pub mod driver {}

/// [engine]: engine
/// [sysvars]: wire::sysvars
/// [recipes]: wire::recipes
/// [state]: wire::state
/// [command]: wire::command
/// [modbus]: wire::modbus
/// [modbus_rtu]: wire::modbus_rtu
/// [slcan]: wire::slcan
#[doc = ""]
#[doc = include_str!("../docs/wire/README.md")]
pub mod wire {
    page!(sysvars: );
    page!(recipes: sysvars);
    page!(state: command sysvars);
    page!(command: state);
    page!(modbus: sysvars modbus_rtu);
    page!(slcan: );

    /// [modbus]: modbus
    /// [engine]: super::engine
    #[doc = ""]
    #[doc = include_str!("../docs/wire/modbus-rtu.md")]
    pub mod modbus_rtu {}
}
