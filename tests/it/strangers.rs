//! Who may not publish to consumers: publishers of another version, and processes of another user, who may not
//! listen either.

use super::publication::{System, message};
use super::python_client::python;
use iceoryx2::prelude::{
    Config, FileName, Node, NodeBuilder, Path as IoxPath, SemanticString, ServiceName,
    ZeroCopySend, ipc_threadsafe,
};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;
use visod::output::message::OdometryMessage;
use visod::output::publication::{
    MAX_NODES, MAX_PUBLISHERS, MAX_SUBSCRIBERS, ODOMETRY_BUFFER, ODOMETRY_SERVICE,
};
use visod::output::publisher::Publisher;
use visod::output::subscriber::{OdometrySubscriber, Wake};

type Ipc = ipc_threadsafe::Service;

/// Longer than anything here takes, even on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);
/// The user and group that are nobody's.
const NOBODY: &str = "65534";

/// A publisher that has not been made by this version, and keeps to none of its checks.
struct Foreign<T: ZeroCopySend + std::fmt::Debug + 'static> {
    port: iceoryx2::port::publisher::Publisher<Ipc, T, ()>,
    _node: Node<Ipc>,
}

impl<T: ZeroCopySend + std::fmt::Debug + Copy + 'static> Foreign<T> {
    fn new(system: &System) -> Self {
        let mut config = Config::global_config().clone();
        config
            .global
            .set_root_path(&IoxPath::new(system.root().as_bytes()).unwrap());
        config.global.prefix = FileName::new(system.prefix().as_bytes()).unwrap();
        let node = NodeBuilder::new().config(&config).create::<Ipc>().unwrap();
        let service = node
            .service_builder(&ServiceName::new(ODOMETRY_SERVICE).unwrap())
            .publish_subscribe::<T>()
            .enable_safe_overflow(true)
            .subscriber_max_buffer_size(ODOMETRY_BUFFER)
            .history_size(1)
            .max_subscribers(MAX_SUBSCRIBERS)
            .max_publishers(MAX_PUBLISHERS)
            .max_nodes(MAX_NODES)
            .open_or_create()
            .unwrap();
        Self {
            port: service.publisher_builder().create().unwrap(),
            _node: node,
        }
    }

    /// Publishes until a process that was given it has ended, or long enough; what it said.
    fn publish_to(&self, value: T, mut consumer: std::process::Child) -> Output {
        let begun = std::time::Instant::now();
        while consumer.try_wait().unwrap().is_none() && begun.elapsed() < PATIENCE {
            self.port.send_copy(value).unwrap();
            std::thread::sleep(Duration::from_millis(50));
        }
        let _ = consumer.kill();
        consumer.wait_with_output().unwrap()
    }
}

/// Messages that nobody of this version can use, and what is said of them.
fn unusable() -> [(OdometryMessage, &'static str); 4] {
    let with = |change: fn(&mut OdometryMessage)| {
        let mut broken = message(1);
        change(&mut broken);
        broken
    };
    [
        (with(|m| m.version = 0), "layout version 0"),
        (with(|m| m.size = 1800), "of 1800 bytes"),
        (with(|m| m.magic = 7), "begins with 0x00000007"),
        (with(|m| m.cov_pose[3] = f64::NAN), "cov_pose"),
    ]
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn messages_of_another_version_are_refused_by_rust_consumers_with_a_sentence() {
    let system = System::new();
    let foreign = Foreign::<OdometryMessage>::new(&system);
    let mut subscriber = OdometrySubscriber::new("test", &system.settings).unwrap();
    for (broken, words) in unusable() {
        foreign.port.send_copy(broken).unwrap();
        assert_eq!(subscriber.wait(PATIENCE).unwrap(), Wake::Message);
        let refusal = subscriber.receive().unwrap_err().to_string();
        assert!(
            refusal.contains(words) && !refusal.contains('\n'),
            "{refusal}"
        );
    }
    // What is right is received all the same.
    foreign.port.send_copy(message(2)).unwrap();
    assert_eq!(subscriber.wait(PATIENCE).unwrap(), Wake::Message);
    assert_eq!(subscriber.receive().unwrap().unwrap().message, message(2));
}

#[test]
fn messages_of_another_version_are_refused_by_listen_and_python_with_a_sentence() {
    let system = System::new();
    let foreign = Foreign::<OdometryMessage>::new(&system);
    for (broken, words) in unusable() {
        let listener = system.listen(&["--json", "--timeout", "3"]);
        let output = foreign.publish_to(broken, listener);
        let listened = said(&output);
        assert!(listened.contains(words), "{listened}");
        assert!(output.stdout.is_empty());
        assert_eq!(output.status.code(), Some(1), "{listened}");
        let Some(mut python) = python("iceoryx2, numpy") else {
            continue;
        };
        let listener = listen_py(&mut python, &system);
        let output = foreign.publish_to(broken, listener);
        let listened = said(&output);
        if words != "cov_pose" {
            assert!(listened.contains(words), "{listened}");
        }
        assert!(
            listened.starts_with("listen.py: ") && listened.lines().count() == 1,
            "{listened}"
        );
        assert!(output.stdout.is_empty());
        assert_eq!(output.status.code(), Some(1), "{listened}");
    }
}

fn listen_py(python: &mut Command, system: &System) -> std::process::Child {
    python
        .args(["listen.py", "--json", "--timeout", "3"])
        .args(["--service-root", &system.root()])
        .args(["--service-prefix", &system.prefix()])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// What a version to come might publish.
#[repr(C)]
#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("visod::OdometryMessage.2")]
struct Later {
    magic: u32,
    version: u32,
    more: [f64; 300],
}

#[test]
fn a_service_of_another_type_is_refused_with_a_sentence() {
    let system = System::new();
    let later = Later {
        magic: 0,
        version: 2,
        more: [0.0; 300],
    };
    let foreign = Foreign::<Later>::new(&system);
    let refusal = OdometrySubscriber::new("test", &system.settings)
        .err()
        .unwrap()
        .to_string();
    assert!(
        refusal.contains("a process of another version uses it"),
        "{refusal}"
    );
    let refusal = Publisher::new(&system.settings).err().unwrap().to_string();
    assert!(
        refusal.contains("a process of another version uses it"),
        "{refusal}"
    );
    let output = foreign.publish_to(later, system.listen(&["--json", "--timeout", "3"]));
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    assert!(
        said(&output).contains("a process of another version uses it"),
        "{}",
        said(&output)
    );
    if let Some(mut python) = python("iceoryx2, numpy") {
        let output = foreign.publish_to(later, listen_py(&mut python, &system));
        let listened = said(&output);
        assert_eq!(output.status.code(), Some(1), "{listened}");
        assert!(
            listened.contains("a process of another version uses it"),
            "{listened}"
        );
        assert_eq!(listened.lines().count(), 1, "{listened}");
    }
}

/// A command of the user whom nobody is.
fn as_nobody(program: &Path, system: &System) -> Command {
    let mut command = Command::new("setpriv");
    command.args(["--reuid", NOBODY, "--regid", NOBODY, "--clear-groups", "--"]);
    command.arg(program);
    command.current_dir("/");
    command.env("VISOD_TEST_ROOT", system.root());
    command.env("VISOD_TEST_PREFIX", system.prefix());
    command.env("VISOD_TEST_COUNT", "3");
    command
}

#[test]
fn another_user_can_neither_read_nor_inject_a_pose() {
    if !rustix::process::geteuid().is_root() {
        println!("skipped: only root can become another user");
        return;
    }
    let system = System::new();
    // The folder lets everybody in: what keeps them out is what visod and iceoryx2 set up below it.
    let folder = Path::new(&system.root()).parent().unwrap().to_owned();
    let open = |path: &Path| {
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).unwrap()
    };
    open(&folder);
    let [visod, tests] = [
        Path::new(env!("CARGO_BIN_EXE_visod")),
        &std::env::current_exe().unwrap(),
    ]
    .map(|program| {
        let copy = folder.join(program.file_name().unwrap());
        std::fs::copy(program, &copy).unwrap();
        open(&copy);
        copy
    });
    let mut subscriber = OdometrySubscriber::new("test", &system.settings).unwrap();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    publisher.publish(&message(0)).unwrap();

    let output = as_nobody(&visod, &system)
        .args(["listen", "--json", "--timeout", "3", "--count", "1"])
        .args([
            "--service-root",
            &system.root(),
            "--service-prefix",
            &system.prefix(),
        ])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    assert!(
        said(&output).contains("belongs to another user"),
        "{}",
        said(&output)
    );
    assert!(output.stdout.is_empty());

    let output = as_nobody(&tests, &system)
        .args(["--exact", "publication::child_publisher", "--ignored"])
        .output()
        .unwrap();
    assert!(!output.status.success(), "another user has published");
    let printed = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(printed.contains("belongs to another user"), "{printed}");

    // Nor does any file that holds messages let him in; what counts nodes iceoryx2 opens to everybody.
    let script = "for file in /dev/shm/$VISOD_TEST_PREFIX* $(find \"$VISOD_TEST_ROOT\" 2>/dev/null); do \
        if [ -f \"$file\" ] && { [ -r \"$file\" ] || [ -w \"$file\" ]; }; then echo \"$file\"; fi; done";
    let output = as_nobody(Path::new("/bin/sh"), &system)
        .args(["-c", script])
        .output()
        .unwrap();
    let open_to_him = String::from_utf8(output.stdout).unwrap();
    println!("open to everybody: {open_to_him}");
    assert!(
        open_to_him.lines().all(|file| file.contains("global_mgmt")),
        "{open_to_him}"
    );
    let ours = std::fs::read_dir("/dev/shm").unwrap().flatten();
    let ours = ours.filter(|entry| {
        entry
            .file_name()
            .to_string_lossy()
            .contains(&system.prefix())
    });
    assert!(
        ours.count() > 0,
        "nothing of this system lies where it was looked for"
    );

    // All that the subscriber got is what the publisher sent.
    assert_eq!(subscriber.receive().unwrap().unwrap().message.sequence, 0);
    assert_eq!(subscriber.receive().unwrap(), None);
}
