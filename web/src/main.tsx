import { effect, useSignal } from "@preact/signals";
import { render } from "preact";
import { words } from "./api";
import { CameraPage } from "./pages/CameraPage";
import { Cameras } from "./pages/Cameras";
import { Events } from "./pages/Events";
import { Health } from "./pages/Health";
import { History } from "./pages/History";
import { SignIn } from "./pages/SignIn";
import { route, type Route } from "./route";
import { mustSignIn, offline, session, signOut, start } from "./state";
import "./style.css";

const PAGES: [Route["page"], string, string][] = [
  ["cameras", "#/", "Cameras"],
  ["events", "#/events", "Events"],
  ["history", "#/history", "History"],
  ["health", "#/health", "Health"],
];

function App() {
  const who = session.value;
  const inside = who !== null && !mustSignIn.value;
  return (
    <>
      <a class="skip" href="#main" onClick={(event) => {
        event.preventDefault();
        document.getElementById("main")?.focus();
      }}>
        To the content
      </a>
      <header class="top">
        <a class="brand" href="#/">
          gakp
        </a>
        {inside && (
          <nav aria-label="Pages">
            {PAGES.map(([page, href, name]) => {
              const here = route.value.page === page || (page === "cameras" && route.value.page === "camera");
              return (
                <a key={page} href={href} aria-current={here ? "page" : undefined}>
                  {name}
                </a>
              );
            })}
          </nav>
        )}
        {inside && who.auth === "required" && <Who name={`${who.name} (${who.role})`} />}
      </header>
      {offline.value && (
        <p class="offline" role="alert">
          Connection lost: the service does not answer. Trying again…
        </p>
      )}
      <main id="main" tabIndex={-1}>
        {who === null ? <p class="quiet">Loading…</p> : mustSignIn.value ? <SignIn /> : <Page route={route.value} />}
      </main>
    </>
  );
}

function Page({ route }: { route: Route }) {
  switch (route.page) {
    case "cameras":
      return <Cameras />;
    case "camera":
      return <CameraPage id={route.camera} />;
    case "events":
      return <Events />;
    case "history":
      return <History />;
    case "health":
      return <Health />;
  }
}

function Who({ name }: { name: string }) {
  const error = useSignal("");
  return (
    <p class="who">
      <span>{error.value || name}</span>
      <button type="button" onClick={() => void signOut().catch((problem) => (error.value = words(problem)))}>
        Sign out
      </button>
    </p>
  );
}

effect(() => {
  const { page, camera } = route.value;
  const name = page === "camera" ? camera : PAGES.find(([which]) => which === page)![2];
  document.title = mustSignIn.value ? "Sign in · gakp" : `${name} · gakp`;
});

start();
render(<App />, document.getElementById("app")!);
