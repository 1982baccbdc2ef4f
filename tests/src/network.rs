//! Several simulated machines on one host: network namespaces with addresses, each linked to a router in the middle.
//! Making them needs privileges. The host's own network does not change.

use std::{
    process::Command,
    sync::atomic::{AtomicU32, Ordering},
};

use crate::skipped::skip;

/// Namespaces joined by a router. Dropping the network removes them; processes in them must have ended before.
#[derive(Debug)]
pub struct Network {
    name: String,
    machines: Vec<String>,
}

/// Runs `ip` with these arguments, and returns what it prints.
fn ip(args: &str) -> Result<String, String> {
    let output = Command::new("ip").args(args.split_whitespace()).output();
    let output = output.map_err(|e| format!("{args}: {e}"))?;
    match output.status.success() {
        true => Ok(String::from_utf8_lossy(&output.stdout).into_owned()),
        false => Err(format!(
            "{args}: {}",
            String::from_utf8_lossy(&output.stderr).trim()
        )),
    }
}

impl Network {
    /// Creates a network of these machines. If that fails, returns `None` and reports the test as skipped.
    pub fn new(machines: &[&str]) -> Option<Self> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let network = Self {
            // Short, because a device's name is limited to 15 characters.
            name: format!("d{}n{count}", std::process::id()),
            machines: machines.iter().map(|&it| it.to_owned()).collect(),
        };
        match network.build() {
            Ok(()) => Some(network),
            Err(why) => {
                skip(&format!("no network namespaces: {why}"));
                None
            }
        }
    }

    fn build(&self) -> Result<(), String> {
        let router = self.namespace("router");
        let mut commands = format!(
            "netns add {router}
            -n {router} link set lo up
            netns exec {router} sysctl -qw net.ipv4.ip_forward=1"
        );
        for (number, machine) in self.machines.iter().enumerate() {
            let namespace = self.namespace(machine);
            let (inner, outer) = (self.machine_end(machine), self.router_end(machine));
            commands += &format!(
                "
                netns add {namespace}
                -n {namespace} link set lo up
                link add {inner} netns {namespace} type veth peer name {outer} netns {router}
                -n {namespace} addr add 10.77.{number}.2/24 dev {inner}
                -n {router} addr add 10.77.{number}.1/24 dev {outer}
                -n {namespace} link set {inner} up
                -n {router} link set {outer} up
                -n {namespace} route add default via 10.77.{number}.1"
            );
        }
        commands
            .lines()
            .try_for_each(|line| ip(line.trim()).map(drop))
    }

    fn machine_index(&self, machine: &str) -> usize {
        let found = self.machines.iter().position(|it| it == machine);
        found.unwrap_or_else(|| panic!("there is no machine {machine}"))
    }

    fn namespace(&self, machine: &str) -> String {
        format!("{}-{machine}", self.name)
    }

    /// A machine's end of its link.
    fn machine_end(&self, machine: &str) -> String {
        format!("{}i{}", self.name, self.machine_index(machine))
    }

    /// The router's end of a machine's link.
    fn router_end(&self, machine: &str) -> String {
        format!("{}o{}", self.name, self.machine_index(machine))
    }

    /// A machine's address.
    pub fn address(&self, machine: &str) -> String {
        format!("10.77.{}.2", self.machine_index(machine))
    }

    /// Returns the prefix that runs a command on a machine, or on the `router`, which can reach every machine.
    pub fn exec_prefix(&self, machine: &str) -> String {
        format!("ip netns exec {}", self.namespace(machine))
    }

    /// Disconnects a machine: packets in flight are lost, and neither side gets an error.
    pub fn disconnect(&self, machine: &str) {
        self.set_link(machine, "down");
    }

    /// Reconnects a machine.
    pub fn reconnect(&self, machine: &str) {
        self.set_link(machine, "up");
    }

    fn set_link(&self, machine: &str, state: &str) {
        let (router, device) = (self.namespace("router"), self.router_end(machine));
        ip(&format!("-n {router} link set {device} {state}")).unwrap();
    }

    /// Limits what a machine sends and receives, in kbit/s; packets beyond that wait at the link. Returns whether the kernel can do this.
    pub fn limit_rate(&self, machine: &str, sent: u32, received: u32) -> bool {
        let router = (self.namespace("router"), self.router_end(machine));
        let ends = [
            ((self.namespace(machine), self.machine_end(machine)), sent),
            (router, received),
        ];
        ends.iter().all(|((namespace, device), kbit)| {
            let words = format!(
                "netns exec {namespace} tc qdisc replace dev {device} root tbf rate {kbit}kbit burst 2kb latency 5s"
            );
            ip(&words).is_ok()
        })
    }

    /// Returns how often a packet that a machine sent had to wait for the limit of its link.
    pub fn delayed_packets(&self, machine: &str) -> u64 {
        let (namespace, device) = (self.namespace(machine), self.machine_end(machine));
        let queue = format!("netns exec {namespace} tc -s -j qdisc show dev {device}");
        let queue: serde_json::Value = serde_json::from_str(&ip(&queue).unwrap()).unwrap();
        queue[0]["overlimits"].as_u64().unwrap()
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        let machines = self.machines.iter().map(|it| self.namespace(it));
        for namespace in machines.chain([self.namespace("router")]) {
            // A namespace may not exist if `build` failed.
            let _ = ip(&format!("netns del {namespace}"));
        }
    }
}
