//! The daemon among the services of its host: what systemd is told, what the scheduler is asked for, and
//! how much time a pair may take.
//!
//! Nothing here knows of cameras or stages; `cli` brings both together.
//!
//! | module | does |
//! |---|---|
//! | [`settings`] | what may be asked for |
//! | [`notify`] | tells systemd: ready, stopping, alive |
//! | [`vitals`] | decides whether the daemon is alive |
//! | [`realtime`] | priorities, processors, memory that stays |
//! | [`budget`] | counts pairs that took too long, and trims features before pairs are dropped |
//! | [`metrics`] | answers those who fetch figures |
//! | [`log`] | to the journal or to a terminal |

pub mod budget;
pub mod log;
pub mod metrics;
pub mod notify;
pub mod realtime;
pub mod settings;
pub mod vitals;

pub use settings::Settings;
